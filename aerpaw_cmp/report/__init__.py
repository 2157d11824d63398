"""Pages, figures and files, written from finished numbers."""

"""Parts of every page: shell, canvas, shapes, files."""

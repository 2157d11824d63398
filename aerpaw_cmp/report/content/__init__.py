"""Contents of pages as records; a file is named by its page."""

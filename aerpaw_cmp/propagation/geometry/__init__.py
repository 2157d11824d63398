"""Arrays, faces and paths, shared by search and field."""

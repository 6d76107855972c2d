"""What goes out: documents, problems, pages, files, representations."""

"""Files of results: in a folder or in a bucket, or in one file, written by us or by others."""

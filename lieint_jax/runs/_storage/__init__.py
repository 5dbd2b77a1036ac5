"""Files of results: in a folder or in a bucket, in chunks or in an archive, written by us or by others."""

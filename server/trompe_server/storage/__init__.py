"""Folders of bytes, arrays as files, the database, access tokens."""

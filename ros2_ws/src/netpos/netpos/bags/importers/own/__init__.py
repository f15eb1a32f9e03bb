"""Anybody's recording: columns of a text file or fields of messages, named on the command line."""

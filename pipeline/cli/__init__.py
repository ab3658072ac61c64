"""The command line: options and printing, one module a group of commands."""

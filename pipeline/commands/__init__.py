"""The commands that work on jobs; `pipeline.cli` puts them together."""

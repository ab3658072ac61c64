"""The model of a job: what a user may write, where it stands in the file, and what is wrong with it."""

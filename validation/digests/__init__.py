"""Small jobs whose outputs are held against those of another version."""

"""Rigid motion: rotations, paths through keyframes, and how long they are."""

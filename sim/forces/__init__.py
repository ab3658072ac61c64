"""Forces from outside that act on every kind of body alike: where, when and how strong a job says."""

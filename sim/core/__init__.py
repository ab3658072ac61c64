"""What every solver stands on: arrays, launches, sums, neighbours, the world; no body of any kind."""

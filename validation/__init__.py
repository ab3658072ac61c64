"""Evidence that the physics is right and that its bits stay the same: cases, figures, digests."""

"""What came out: plans, how they are replayed, and the tours in them."""

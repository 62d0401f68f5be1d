"""What is learned from: transitions stored, relabelled or imagined."""

"""What a training leaves behind: its folder, its checkpoints, and how it is stopped."""

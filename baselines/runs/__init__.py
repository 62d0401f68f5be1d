"""Run folders: files, checkpoints, studies of several runs."""

"""Files: scenes, terrain, images and checkpoints. Everything here runs on the host; nothing is traced."""

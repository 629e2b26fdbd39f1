"""From a scene to a picture: the only place where pictures are cut into batches."""

"""What a user builds: objects, materials, lights and cameras, and the origin from which they are traced."""

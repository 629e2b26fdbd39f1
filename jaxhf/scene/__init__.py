"""What a user builds: objects, materials, lights and cameras, and the origin relative to which they are traced."""

"""What every stage needs: types, settings, vectors, frames; plain arithmetic."""

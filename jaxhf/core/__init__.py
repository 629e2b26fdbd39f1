"""What every stage needs: types, settings, vectors, frames, devices, and how programs are kept small."""

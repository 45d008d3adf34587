"""Other renderers of the same picture, each in its own file, which imports what it needs."""

"""Other renderers of the same picture, each in a file of its own that imports what it needs."""

"""Reading volumes from files, and the store on disk.

    reading.py      `read_volume`, `open_source`; each file format is a module in formats/
    stores/         `Store`, a volume on disk that is read by blocks; `convert`, any volume to one

Nothing is imported here, so that the command line can list the formats without importing torch.
"""

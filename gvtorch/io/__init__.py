"""Reading volumes from files, and the store on disk.

    reading.py      `read_volume`, `open_source`, over one file a format in formats/
    stores/         `Store`, a volume on disk that is read by blocks; `convert`, any volume to one

Nothing is imported here: the command line names the formats without waiting for torch.
"""

"""Reading volumes from files, and the store on disk.

    reading.py      `read_volume`, `open_source`, over one file a format in formats/
    conversion.py   `convert`, `estimate`: any volume to a store; conversion_plan.py: its price
    store.py        `Store`: a volume on disk, read block by block

Nothing is imported here: the command line names the formats without waiting for torch.
"""

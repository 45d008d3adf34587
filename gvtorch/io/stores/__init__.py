"""Stores: OME-Zarr images with, in addition to the pyramid, bordered blocks for streaming.

    store.py         `Store`: reads gvtorch's stores and any other OME-Zarr image, block by block
    store_layout.py  the layout of a store on disk
    tensorstores.py  tensorstore's settings, deadlines, files and arrays
    conversion.py    `convert`, `estimate`: any volume to a store; conversion_plan.py: its cost
    unfinished.py    a store that is being written: lock, journal, the last step
    shard.py         one task of the converter
    level_reader.py  levels of an image, computed where they are missing
    ngff.py          OME-Zarr metadata
    channels.py      stores of several channels; coarse.py: colours of coarse levels
    chunk_files.py   limits on chunk files; checksums.py: whether a file is the one written

Nothing is imported here.
"""

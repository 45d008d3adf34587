"""Stores: OME-Zarr images with bordered blocks for streaming beside the pyramid.

    store.py         `Store`: reading, block by block, of our own and of any other OME-Zarr image
    store_layout.py  how a store lies on disk
    conversion.py    `convert`, `estimate`: any volume to a store; conversion_plan.py: its price
    unfinished.py    a store in the making: lock, journal, the last step
    shard.py         one task of the converter
    level_reader.py  levels of an image, made where they are missing
    ngff.py          OME-Zarr metadata
    channels.py      stores of several channels; coarse.py: colours of coarse levels
    chunk_files.py   what a chunk's file may be; checksums.py: that it is the right one

Nothing is imported here.
"""

"""A drive as one MCAP file: writing, reading, and viewing.

Read `recording` first; `scene` converts records to Foxglove messages, `recorded_images` is a source of recorded images.
"""

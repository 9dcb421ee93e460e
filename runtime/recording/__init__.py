"""A drive as one MCAP file: written while it goes on, and read again.

Read `recording` first; `scene` turns records into messages that Foxglove draws, `recorded_images` plays a
recording's images as a source.
"""

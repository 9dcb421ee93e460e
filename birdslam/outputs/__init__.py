"""What a drive leaves on disk: trajectories, the map, a picture from above, a video. Read `drive_files` first."""

"""The files of a drive: trajectories, map, bird's-eye picture, video. Start with `drive_files`."""

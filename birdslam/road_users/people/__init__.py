"""People, cyclists and riders in bird's-eye view, with ids that persist through a second of occlusion.

`people_boxes` reads a detector's boxes, `box_model` has their measurement model, `people_motion` the motion model.
`people_filter` estimates places, velocities and heights, `people_tracker` tracks, `people_records` makes the records of
a frame. The road under people is that of `state.ground_size_filter`.
"""

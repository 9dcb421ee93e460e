"""The built-in world: a street with traffic, seen by a car's camera, with exact truth (numba, extra `train`).

It trains the shipped networks and made the shipped drive. Read `world` first: `sample(seed, ...)` gives one frame of
a world of its own, `World(seed).frames(n)` a drive. What both give is a `truth.WorldFrame`: the image, and depth,
classes, instances, objects, lanes and road as they truly are.

Three packages, each importing only those before it:

- `street`: where a street leads (`course`), its lanes, lines, surfaces and crossings (`street_plan` draws one);
- `rendering`: triangles, light and the camera. `renderer` is the way of a frame through it: meshes of all bodies,
  z-buffer (`rasteriser`), shadows, shading (`shading`, `ground`, `surfaces`, `paint`, `light`); `photometrics` makes
  an image of the light. `materials` names the slots of a body's parameters, `scene` is its interface to the rest;
- `traffic`: which vehicles and people there are (`fleet`), what stands beside the street (`placement`, `parking`),
  and how everybody moves (`flow`).

Above them `labels` reads the truth off a rendered scene, `scenario` lets a world drive, `demo_world` is the shipped one
and `roads` has hard ones; `dashcam` films a scenario as a dashboard camera does. `windscreen` and `compression` change
images that are done, with OpenCV and numpy alone.
"""

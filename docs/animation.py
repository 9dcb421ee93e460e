"""Makes an animated WebP of a part of a film: python docs/animation.py drive.mp4 docs/drive.webp FIRST END"""

import sys
from pathlib import Path

import cv2
from PIL import Image

WIDTH_PX, EVERY, PERIOD_MS, QUALITY = 960, 2, 120, 70

film, target, first, end = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
capture, images = cv2.VideoCapture(film), []
for k in range(end):
    ok, image = capture.read()
    if not ok:
        break
    if k >= first and (k - first) % EVERY == 0:
        height_px = round(image.shape[0] * WIDTH_PX / image.shape[1])
        small = cv2.resize(image, (WIDTH_PX, height_px), interpolation=cv2.INTER_AREA)
        images.append(Image.fromarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB)))
images[0].save(target, save_all=True, append_images=images[1:], duration=PERIOD_MS, loop=0, quality=QUALITY, method=6)
print(f"{target}: {len(images)} images, {target.stat().st_size / 1e6:.1f} MB")

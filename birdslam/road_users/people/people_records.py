"""Records of all tracked people in a frame."""

from __future__ import annotations

import math

import numpy as np

from birdslam.road_users.models.user_state import HEIGHT, PLACE, VELOCITY
from birdslam.road_users.people.people_tracker import PeopleTracker
from birdslam.road_users.track import EgoFrame
from birdslam.types import FollowedPerson, Moves

MIN_REPORT_FRAMES = 4  # number of observations until the motion is reported


def followed_people(tracker: PeopleTracker, present: EgoFrame) -> tuple[FollowedPerson, ...]:
    """Records of the current frame; people of an earlier frame are extrapolated."""
    tracks, frame = tracker.tracks, tracker.frame
    if not tracks or frame is None:
        return ()
    after_s = max(0.0, (present.t_source_ns - frame.ego.t_source_ns) * 1e-9)
    stand = np.array([track.is_stationary and track.hits >= MIN_REPORT_FRAMES for track in tracks], dtype=np.bool_)
    moments = tracker.filter.moments(after_s, stand)
    R, T = present.T_world_ego.rotation(), present.T_world_ego
    at = ((moments.mean[:, PLACE] - [T.x_m, T.y_m]) @ R).tolist()
    velocity = (moments.mean[:, VELOCITY] @ R).tolist()
    cov = (R.T @ moments.cov[:, PLACE, PLACE] @ R).reshape(-1, 4).tolist()
    velocity_cov = (R.T @ moments.cov[:, VELOCITY, VELOCITY] @ R).reshape(-1, 4).tolist()
    log_height, sigma = moments.mean[:, HEIGHT].tolist(), np.sqrt(moments.cov[:, HEIGHT, HEIGHT]).tolist()
    child, standing = (np.clip(share, 0.0, 1.0).tolist() for share in (moments.odd_size, moments.standing))
    stands, out = stand.tolist(), []
    for k, track in enumerate(tracks):
        if track.number < 0:
            continue
        height_m = math.exp(log_height[k])
        sizes = tracker.config.priors(track.label)
        (x, y), (vx, vy) = at[k], velocity[k]
        moves = Moves.STANDING if stands[k] else Moves.DRIVING if track.hits >= MIN_REPORT_FRAMES else Moves.UNDECIDED
        out.append(
            FollowedPerson(
                person=track.number,
                x_m=x,
                y_m=y,
                cov=_symmetric(cov[k]),
                vx_mps=vx,
                vy_mps=vy,
                velocity_cov=_symmetric(velocity_cov[k]),
                label=track.label,
                label_probability=track.label_probability,
                score=track.box.score,
                box_px=track.box.box_px,
                height_m=height_m,
                sigma_height_m=height_m * sigma[k],
                child=child[k],
                length_m=sizes.length_m,
                width_m=sizes.footprint_m,
                standing=standing[k],
                moves=moves,
                age_ns=max(0, present.t_source_ns - track.frame.t_source_ns),
                frames=track.hits,
            )
        )
    return tuple(sorted(out, key=lambda person: person.person))


def _symmetric(cov: list[float]) -> tuple[float, ...]:
    xx, xy, yx, yy = cov
    return xx, (xy + yx) / 2.0, (xy + yx) / 2.0, yy

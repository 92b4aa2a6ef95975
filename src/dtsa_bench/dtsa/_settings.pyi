"""The settings of `simulate` and `run_config`: made by `python -m dtsa_dev.documents.pages`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypedDict

class RunSettings(TypedDict, total=False):
    """Units and ranges: docs/reference/settings.md and docs/reference/channel.md."""

    adoption: bool
    age_cap: float
    agents: int
    anchor_every: int
    anchor_rest: int
    announce: bool
    auth: bool
    auth_session: int
    avoider: str
    axis_x_m: float
    axis_y_m: float
    axis_z_m: float
    bitrate: int
    boot_round: bool
    burst_length: float
    burst_scope: Literal["receiver", "link"]
    c_r: int
    capture_db: float
    collision_m: float
    control_ms: float
    depth_rate: float
    epsilon: float
    estimator: str
    extent_m: float
    frame: Literal["auto", "paper", "extended"]
    gossip: bool
    interference_factor: float
    jam: bool
    jitter_m: float
    lease_share: float
    link_delay_ns: int
    link_loss: Any
    loss: float
    loss_matrix: Any
    losses: Any
    moving: int | None
    open_every: int
    options: Mapping[str, float]
    p_bad: float
    p_good: float
    partition: Any
    path_loss_exponent: float
    pause_slots: int
    permute: bool
    places: str
    policy: str
    r_min: float
    radio: Literal[
        "plain",
        "crazyflie",
        "sik-64k",
        "sik-125k",
        "sik-250k",
        "e22-62k",
        "e22-38k",
        "e22-19k",
        "xbee",
        "esp-now",
    ]
    ramp_up_ns: int
    range_m: float
    return_every: int
    scenario: Literal["exchange", "staggered", "waypoints", "streams", "stop-and-go"]
    schedule: Any
    seed: int
    selection: Literal["candidates", "pairwise"]
    shape: Literal["circle", "ellipse", "ellipsoid"]
    slot_ms: float
    stagger_slots: int
    stop_on_crash: bool
    stops: int
    tail_s: float
    targets_known: bool
    timeout_s: float

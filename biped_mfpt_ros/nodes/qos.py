"""Quality of service of every topic and service of the pipeline, by purpose."""

from __future__ import annotations

from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

RESULTS = QoSProfile(
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=512,
)
"""`mesh/info`, `mesh/states`, `mesh/transitions`, `mfpt`, `optimisation/trials`.

Nothing may be missing, so reliable. An analysis or a recorder that starts late still gets what was
published, so transient local. The depth bounds what a publisher keeps for them: messages are at
most about 1 MB, and 512 hold the transitions of a mesh of a million states.
"""

PROGRESS = QoSProfile(
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.VOLATILE,
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=16,
)
"""`mesh/progress`: only the latest counts, so a slow reader may miss some and a late one all."""

LATEST = QoSProfile(
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=1,
)
"""`optimisation/best`: only the latest counts, and who comes late still gets that one."""

REQUESTS = QoSProfile(
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.VOLATILE,
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=256,
)
"""`simulate_steps`, `compute_mfpt`: for all callers together, who keep several requests in flight.
The default depth of 10 would silently drop the oldest ones. See `fair_service`.
"""

"""Grid SLAM in the plane: scan matching, keyframes, loop closure, occupancy grid.

```python
from instant_ic.slam import GridSlam, Scan, SlamConfig

slam = GridSlam(SlamConfig())
result = slam.process(scan, odom_pose=np.array([0.1, 0.0, 0.0]))
grid, resolution, origin = slam.grid()
```
"""

from instant_ic.slam.config import SlamConfig
from instant_ic.slam.front_end import SlamStatus
from instant_ic.slam.grid_slam import GridSlam, SlamResult
from instant_ic.slam.occupancy import OccupancyGrid
from instant_ic.slam.scan import Scan

__all__ = [
    "GridSlam",
    "OccupancyGrid",
    "Scan",
    "SlamConfig",
    "SlamResult",
    "SlamStatus",
]

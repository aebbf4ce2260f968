"""Mean first-passage time to a fall of a five-link biped that walks on rough ground.

From Python, without ROS:

- `walker.robot`: `Robot`, `WalkerModel`; `walker.terrain.slope_set`; `walker.outcome.Outcome`;
  `models.robot_from_file`
- `control.controller`: `Controller`, `controller`, `controller_names`, `SCHEMES`
- `gait.step.simulate_steps`, `gait.cycle.find_limit_cycle`, `gait.monte_carlo.monte_carlo`,
  `gait.trace.trace_swing`
- `chain.mesh.grow_mesh`, `chain.markov.metastability` and `metastabilities`
- `optimise.settings.StudySettings`, `optimise.store.Store`, `optimise.study.Study`,
  `optimise.study.best_trial`, `optimise.local.LocalBackend`
"""

__version__ = "0.1.0"

"""Checks exported motions, sampled at 1 kHz, against the limits in URDF and YAML files.

`files` and `check` are independent of the package: like the oracle, they read the plan (.npz or
CSV), scene, URDF and YAML files themselves. `plans` plans motions and exports them.

`python -m tests.limits FOLDER_OR_FILE ...` checks files. `python -m tests.limits --make 500 FOLDER`
first plans the tasks of all experiments and of random rooms.
"""

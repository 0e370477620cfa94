"""Checks limits of exported motions, sampled at 1 kHz, against URDF and YAML files.

`files` and `check` share nothing with the package: they read a plan's .npz or CSV, scene, URDF and
YAML files by themselves, with numpy and PyYAML. `plans` has plans made. `python -m tests.limits
FOLDER_OR_FILE ...` judges files, and `python -m tests.limits --make 500 FOLDER` makes plans of all
the experiments' tasks and of random rooms, and judges these.
"""

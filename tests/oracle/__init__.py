"""A second opinion on saved motions, that shares no line with the package.

It reads a plan's .npz, scene, URDFs and YAML files by itself and judges the motion by what docs/
says of these files and of what a motion must keep to. It imports numpy, PyYAML, Pinocchio for
kinematics, coal for distances, trimesh for meshes, and nothing of vkc_pin: `test_oracle.py` makes
sure.

Run it with `python -m tests.oracle FOLDER_OR_PLAN ...`.
"""

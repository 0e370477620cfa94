"""Validates saved motions independently of the package.

The oracle reads the plan (.npz), scene, URDF and YAML files itself, and checks the motion against
the rules in docs/. It imports numpy, PyYAML, Pinocchio for kinematics, coal for distances and
trimesh for meshes, but not vkc_pin, which `test_oracle.py` verifies.

Usage: `python -m tests.oracle FOLDER_OR_PLAN ...`.
"""

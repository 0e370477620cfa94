"""Whole-body planning for mobile manipulators on virtual kinematic chains."""

"""Objects that can be opened, made from files of other programs: URDF, MJCF, SDF."""

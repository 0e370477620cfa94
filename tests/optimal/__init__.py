"""How much longer motions take than the fastest along the same paths, which TOPP-RA finds on a fine grid."""

"""How robots drive: kinds of base beside each other."""

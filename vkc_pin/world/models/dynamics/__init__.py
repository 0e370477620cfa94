"""What it takes to move objects: their weight, and friction, damping and springs of their joints."""

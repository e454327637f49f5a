"""An episode: its loop, its clock, and the attribution of its errors."""

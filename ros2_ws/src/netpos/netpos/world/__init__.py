"""Where things are and how they move: maps, lines of sight, routes, motion, frames. Metres in map
(east, north, up)."""

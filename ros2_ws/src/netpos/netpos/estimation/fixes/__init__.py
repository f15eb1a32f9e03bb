"""A position from measurements alone: ``position_fix`` of one epoch in space, ``phase_fix`` of a
range and a phase, sector by sector."""

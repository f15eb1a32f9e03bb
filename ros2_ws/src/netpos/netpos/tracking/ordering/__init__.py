"""Time: ``sequencer`` makes epochs in the order of stamps, ``clocks`` says whose clock is right,
``history`` goes back when a measurement comes late."""

"""The simulated radio: noise streams, device clocks, arrays, waveforms, lines of sight,
measurements."""

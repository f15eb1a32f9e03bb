"""Tools that several rooms share: declared parameters, files, YAML, nonlinear least squares."""

"""What several rooms need and none owns: declared parameters, nonlinear least squares."""

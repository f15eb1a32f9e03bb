"""What people see of a running graph: shapes on a map, and a table in a terminal."""

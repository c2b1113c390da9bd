"""Motion as the minimum of an energy: terms as pure functions, problems that list them, solvers."""

"""Many runs: Monte Carlo studies, parameter sweeps and fault campaigns."""

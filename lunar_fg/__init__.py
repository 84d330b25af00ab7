"""The core: datasets, the factor graph, the navigator, evaluation."""

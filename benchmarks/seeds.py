"""Seeds of simulated worlds: options are chosen on the first, figures reported on the second."""

TUNING = (0, 1, 2, 3, 4)
REPORTING = tuple(range(100, 140))

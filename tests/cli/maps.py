"""Arguments of `stillmap map` for tests."""

QUICK = ("--set", "em.max_iterations=1")
TWO_ITERATIONS = ("--set", "em.max_iterations=2", "--set", "em.patience=9")
TWO_ITERATIONS += ("--set", "em.tolerance=0", "--set", "em.label_tolerance=0")
# goes on for long
ENDLESS = ("--set", "em.max_iterations=100000", "--set", "em.patience=100000")
ENDLESS += ("--set", "em.tolerance=0", "--set", "em.label_tolerance=0")

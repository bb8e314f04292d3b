"""The EM loop: M-step, E-step, bound; its estimate, checkpoints and result."""

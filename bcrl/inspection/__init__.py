"""Looking into a boosted Q-function: what each residual is worth, and where."""

"""The regressors of fitted Q-iteration."""

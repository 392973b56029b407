"""The paper's figures, and learning curves of any other environment."""

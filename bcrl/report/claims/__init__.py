"""The paper's claims, each with the quantity that decides it and a verdict."""

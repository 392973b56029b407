"""Tables and figures from `runs/`; imports none of the training code."""

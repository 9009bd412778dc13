"""Co-registration: scans registered with a model as prior, and the model learned again [BlendSCAPE]."""

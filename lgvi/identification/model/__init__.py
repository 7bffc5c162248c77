"""What is fitted: a model, its free leaves and the initial states."""

"""Studies: trainings of scenes with one thing varied, such as the number of samples."""

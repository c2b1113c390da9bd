"""Methods that systems are compared with: their trainings, figures of their papers, baselines and scores."""

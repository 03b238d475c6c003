"""Run methods over sequences, export their trajectories, score them from the files, report and plot."""

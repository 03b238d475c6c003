"""Write a drive of any data set, simulated ones above all, in the native format of another: one module per format."""

"""The commands (train, evaluate, data, evaluation) and what they share: options, messages, run folders."""

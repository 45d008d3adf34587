"""The torch twins of the ops: right by definition, plain enough to check by eye."""

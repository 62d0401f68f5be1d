"""The faces: dictionaries and spaces on one side, arrays on the other."""

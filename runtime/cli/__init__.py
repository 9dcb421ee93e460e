"""The command `birdslam`: `parser` has the command lines, imported before numpy; `dispatch` says what each calls."""

"""What is done with a whole surrogate: wait for its design, ask what its budget holds, move it into a file and back."""

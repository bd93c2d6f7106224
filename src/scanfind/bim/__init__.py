"""What was found, back into the BIM: issues as BCF, and a copy of the design that says what was built."""

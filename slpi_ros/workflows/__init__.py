"""What is done with records, each job once: a request in, an outcome out, without printing and without pages."""

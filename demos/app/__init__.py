"""The application behind `mixed-fem`: command line, scenes, runs, results, pictures."""

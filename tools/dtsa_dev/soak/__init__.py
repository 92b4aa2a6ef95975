"""What is too long for the tests: named soaks that are resumed where they stopped and leave a record of figures."""

"""What the tests of several folders share: toys, small worlds, hostile programs, servers, and their checks."""

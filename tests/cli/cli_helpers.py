"""Helpers of the tests of the command line."""


def one_line(err):
    assert err.startswith("error: ") and err.count("\n") == 1 and "Traceback" not in err
    return err

"""Test the line about fixes outside the maps."""

from socast.tools.terminal.cleaning_options import describe_outside, warn_outside


def counts(**by_tile):
    return {"elevation_map": {"fixes": 5000, "outside": sum(by_tile.values()), "outside_by_tile": by_tile}}


def test_line_names_the_tiles_with_most_fixes_first_and_counts_the_others():
    tiles = {f"N{n:02d}E000": n for n in range(1, 9)}
    line = describe_outside(counts(**tiles))
    assert line.startswith("36 of 5,000 fixes lie outside the maps of --elevation")
    assert "in N08E000, N07E000, N06E000, N05E000, N04E000 and 3 more tiles;" in line


def test_nothing_is_printed_without_a_map_or_with_all_fixes_inside(capsys):
    for quality in ({}, counts()):
        warn_outside(quality)
    assert capsys.readouterr() == ("", "")


def test_line_goes_to_standard_error(capsys):
    warn_outside(counts(N45W074=3))
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)

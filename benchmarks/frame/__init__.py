"""What all benchmarks share; each of them is a file that says what it asks and fills this in.

`layouts`
    Synthetic scenes by layout, half and seed.
`scans`
    Real scans and ray-cast piles, and the detection of parts in them on the clock.
`runs`
    Methods on scenes, in turn and timed, in one process or several, and scored.
`ours`
    This package as a method, behind the same contract as the other programs in benchmarks/peers.
`timing`
    The clock, runs in turn, the growth of a time with a size.
`records`
    Where results go: csv files, and tables in pages between ``<!-- NAME -->`` and ``<!-- end -->``.
`tables`, `plots`
    Markdown, and figures.
`cli`
    Arguments that several have, and the line that names the machine.
"""

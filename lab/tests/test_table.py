"""The table leaves no seed out, and says where rows that are compared were not made alike."""

from dataclasses import replace

import pytest

from support.terminal import on_terminal
from surrogym.cli.columns import ENDLESS
from surrogym_lab.reproduce.markdown import fitted
from surrogym_lab.reproduce.page import NoSuchPlace, present_sections, section, update
from surrogym_lab.reproduce.pictures import draw_tasks
from surrogym_lab.reproduce.rows import Row, write_rows
from surrogym_lab.reproduce.table import headline, report

MARKDOWN = """\
| task | what was asked | result |
| --- | --- | --- |
| pendulum | mean -160, all upright | reached |
| cartpole | all 500 | - |

A sentence that is broken
where it was not.
"""

ROW = Row(
    *("pendulum", "default", 0, 14, 4, 5, 9),
    mean=-150.0,
    min=-400.0,
    success=1.0,
    also_success=0.99,
    reached=True,
    imagined=-140.0,
    virtual_steps=589_824,
    seconds=50.0,
    commit="abc",
    configuration="c",
)
DEFAULT = [
    replace(ROW, seed=i, mean=m, success=s, reached=r, real_steps=9 + i)
    for i, (m, s, r) in enumerate(
        [(-150.0, 1.0, True), (-160.0, 0.9, False), (-1000.0, 0.2, False), (-155.0, 1.0, True)]
    )
]
HYPERCUBE = [replace(ROW, arm="latin_hypercube", seed=i, mean=-400.0 - i, reached=False) for i in range(4)]


def line(text: str, *cells: str) -> str:
    (found,) = [one for one in text.splitlines() if one.startswith(f"| {' | '.join(cells)} |")]
    return found


def test_the_study_table_includes_every_seed():
    text = report(DEFAULT)
    assert line(text, "pendulum", "default") == (
        "| pendulum | default | 4 | 10.5 (9 to 12) | -157.5 (-1000.0 to -150.0) | -1000.0 | -400.0 | 20 % | 99 % |"
        " -140.0 | 2 of 4 | 589,824 | 50 (50) |"
    )
    assert line(text, "pendulum", "10.5 (9 to 12)").endswith("| 2 of 4 | -1000.0 |")
    oracle = [replace(ROW, arm="oracle", seed=i, real_steps=steps) for i, steps in enumerate((1_008_448, 900_000))]
    assert "| 954,224 (900,000 to 1,008,448) |" in line(report(oracle), "pendulum", "oracle")


def test_a_failed_study_run_counts_as_missing_the_target():
    bad = Row("pendulum", "default", 4, 14, error="exit code 1: no")
    text = report([*DEFAULT, bad])
    assert "| 5, 1 ended badly |" in line(text, "pendulum", "default")
    assert "| 2 of 5 |" in line(text, "pendulum", "default")
    assert "| 1, 1 ended badly | - |" in report([bad])


def test_study_variants_are_compared_in_pairs_with_an_interval():
    adaptive = [replace(row, arm="no_loop") for row in DEFAULT]
    text = report([*HYPERCUBE, *[row for row in adaptive if row.seed != 2]])
    told = line(text, "pendulum", "adaptive queries", "no_loop, latin_hypercube", "3, 4")
    assert told.endswith("| no_loop |")
    assert "undecided" in line(
        report([*HYPERCUBE, *adaptive]), "pendulum", "adaptive queries", "no_loop, latin_hypercube"
    )
    assert "closed loop" not in text
    assert text.index("| pendulum | no_loop |") < text.index("| pendulum | latin_hypercube |")


def test_the_study_table_names_what_two_compared_variants_differ_in():
    """A budget of 14 is all the design's, one of 60 leaves queries for three rounds."""
    asked = [*DEFAULT, *[replace(row, arm="no_loop") for row in DEFAULT]]
    assert line(report(asked), "pendulum", "an early stop", "default, no_loop")
    to_the_end = report([replace(row, real_steps=14) for row in [*asked, *HYPERCUBE]])
    assert "default, no_loop" not in to_the_end, "the same design twice compares nothing"
    assert line(to_the_end, "pendulum", "adaptive queries", "default, latin_hypercube")
    with_rounds = [replace(row, task="swingup", budget=60) for row in asked]
    assert line(report(with_rounds), "swingup", "closed loop", "default, no_loop")


def test_the_study_table_warns_about_rows_of_different_origin():
    assert "configurations" not in report(DEFAULT)
    assert "of 2 commits" not in report(DEFAULT)
    assert "pendulum, default, budget 14: rows of 2 commits" in report([*DEFAULT, replace(ROW, seed=9, commit="d")])
    assert "pendulum, default, budget 14: rows of 2 configurations" in report(
        [*DEFAULT, replace(ROW, seed=9, configuration="d")]
    )


def test_the_study_table_lists_runs_with_other_budgets_separately():
    text = report([*DEFAULT, replace(ROW, budget=7, mean=-900.0)])
    assert line(text, "pendulum", "default, budget 7", "1")


def test_each_study_task_gets_a_picture(tmp_path):
    written = draw_tasks(tmp_path, [*DEFAULT, *HYPERCUBE, Row("cartpole", "default", 0, 8, error="no")])
    assert [path.name for path in written] == ["efficiency-pendulum.png"]
    assert written[0].stat().st_size > 5_000


def test_study_tables_and_pictures_are_inserted_between_the_marks_of_a_page(tmp_path):
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("before\n<!-- efficiency: begin -->\nold\n<!-- efficiency: end -->\nafter\n")
    update(page, DEFAULT, page.parent / "results")
    assert present_sections(page) == {"efficiency": section("efficiency", DEFAULT, "results")}
    assert page.read_text().startswith("before\n<!-- efficiency: begin -->\n\n| task | real steps |")
    assert page.read_text().endswith("![pendulum](results/efficiency-pendulum.png)\n<!-- efficiency: end -->\nafter\n")
    assert (page.parent / "results" / "efficiency-pendulum.png").exists()
    page.write_text("<!-- headline: begin -->\nold\n<!-- headline: end -->\n")
    update(page, DEFAULT, page.parent / "results")
    assert page.read_text() == f"<!-- headline: begin -->\n\n{headline(DEFAULT)}\n<!-- headline: end -->\n"
    page.write_text("no marks")
    with pytest.raises(NoSuchPlace, match="<!-- efficiency: begin -->"):
        update(page, DEFAULT, tmp_path)


def test_the_study_table_counts_promised_returns_that_held():
    """Seed 1 is below its promise and, of a gain of 30, 20 short of it."""
    interval = {"promise": -150.0, "promise_low": -155.0, "promise_high": -145.0, "without": -180.0}
    kept = replace(ROW, trusted=True, audit_steps=8, **interval)
    rows = [
        kept,
        replace(kept, seed=1, mean=-170.0, audit_steps=16),
        replace(kept, seed=2, trusted=False),
        replace(kept, task="cartpole", budget=8, without=None),
    ]
    text = report(rows)
    share = "1 of 2 (1 to 99 %)"
    assert line(text, "pendulum", "3", "8 to 16", "3", "2", "2 of 3 (9 to 99 %)").endswith(f"| {share} | {share} |")
    assert line(text, "all", "4", "8 to 16", "4", "3", "3 of 4 (19 to 99 %)").endswith(
        f"| 2 of 3 (9 to 99 %); by tasks 50 to 100 % | {share} |"
    )
    assert line(text, "pendulum", "3", "0.333").endswith("| 3.667 | 3.667 | 2 of 3 (9 to 99 %) |")
    assert "Promises" not in report([ROW])


def test_the_study_table_fits_a_terminal(tmp_path):
    """The file keeps its wide Markdown."""
    rows = [
        Row("pendulum", "default", seed, 14, 4, 5, 9, mean=-150.0 - seed, min=-400.0, reached=True, seconds=1.0)
        for seed in range(3)
    ]
    write_rows(tmp_path / "rows.csv", rows)
    arguments = ("table", "--rows", "rows.csv", "--out", "both")
    with on_terminal(*arguments, module="surrogym_lab", width=80, folder=str(tmp_path)) as terminal:
        terminal.await_text("Commits:")
        assert "worst episode   -400.0" in terminal.shown
        assert max(map(len, terminal.shown.splitlines())) <= 80
    assert max(map(len, (tmp_path / "both" / "efficiency.md").read_text().splitlines())) > 80


@pytest.mark.parametrize("width", [30, 40, 60, 80])
def test_markdown_is_wrapped_to_the_terminal_width_without_losing_words(width):
    shown = fitted(MARKDOWN, width)
    assert max(map(len, shown.splitlines())) <= width
    assert set(MARKDOWN.replace("|", " ").replace("---", "").split()) <= set(shown.split())
    assert "\n\nA sentence that is broken where" in fitted(MARKDOWN, 80).replace("was\n", "was ")


def test_markdown_written_to_a_file_is_not_wrapped():
    assert fitted(MARKDOWN, ENDLESS) == MARKDOWN

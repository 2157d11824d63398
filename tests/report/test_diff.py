"""Check that the comparison of two reports finds a planted change, its place and its size.

Equal reports have no difference.
"""

import json
import shutil

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.content import KEY
from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.outputs import OutputFolder
from aerpaw_cmp.compare.statistics import pooled_difference
from aerpaw_cmp.jobs.diff_reports import DIFFERENCE, run_diff, verdict
from aerpaw_cmp.report.flight import write_report
from tests.json_page import unlisted

LINK = ("LW1", "USRP1")


@pytest.fixture(scope="module")
def written(report_data, tmp_path_factory):
    """A report as the command writes it, without figures, every eighth sample."""
    folder = tmp_path_factory.mktemp("reports") / "first"
    with OutputFolder(folder, job="report") as output, output.filling() as place:
        write_report(report_data, place, drawn="none")
        table = change_table(place, "rss", lambda full: full.iloc[::8])

        def recount(metrics):
            for tower, channels in metrics["rss"].items():
                for channel, numbers in channels.items():
                    numbers["n"] = int(table.loc[on(table, (tower, channel)), "residual_db"].notna().sum())

        change_metrics(place, recount)
    return folder


@pytest.fixture
def pair(written, tmp_path):
    """Return two copies of a report, of which tests may change the second."""
    first, second = tmp_path / "first", tmp_path / "second"
    shutil.copytree(written, first)
    shutil.copytree(written, second)
    return first, second


def change_metrics(folder, change):
    path = folder / "metrics.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content)
    path.write_text(json.dumps(content), encoding="utf-8")


def change_table(folder, kind, change):
    path = folder / f"{kind}.csv"
    table = pd.read_csv(path)
    table = change(table)
    table.to_csv(path, index=False, lineterminator="\n")
    return table


def on(table, link=LINK):
    return (table["tower"] == link[0]) & (table["channel"] == link[1])


def test_equal_reports_have_no_difference(pair, capsys):
    change_metrics(pair[1], lambda m: m.update(generated="later", stages={"read_s": 99.0}))
    diff = run_diff(*pair)
    assert diff.differences == ()
    assert (diff.settings, diff.inputs, diff.versions) == ((), (), ())
    assert verdict(diff).startswith("No difference: the numbers agree within 0.01 dB.")
    assert {row.rmse.difference_db for row in diff.levels} == {0.0}
    assert {row.kappa.difference for row in diff.ranks} == {0.0}
    assert main(["diff", str(pair[0]), str(pair[1]), "--strict"]) == 0
    assert "No difference" in capsys.readouterr().out


def test_one_setting_is_named_by_its_key(pair):
    change_metrics(pair[1], lambda m: m["settings"]["rt"].update(max_depth=1, engine=None))
    change_metrics(pair[1], lambda m: m["versions"].update(numpy="1.0"))
    diff = run_diff(*pair)
    assert [(*e.values(),) for e in diff.settings] == [("rt.max_depth", 2, 1), ("rt.engine", None, None)]
    assert [e["key"] for e in diff.versions] == ["numpy"]
    assert diff.differences == (), "a setting alone is no number"
    assert "1 version" in verdict(diff)


def test_fingerprints_that_differ_are_printed_by_their_first_digits(pair, capsys):
    """A fingerprint has 2000 digits, so a table shows only the first."""
    fingerprints = ["3501f" + "7a" * 1000 + "f" + "0c" * 256, "3502f" + "6b" * 1000 + "f"]
    change_metrics(pair[1], lambda m: m["settings"].update(rank={"marks": fingerprints}))
    assert main(["diff", str(pair[0]), str(pair[1])]) == 0
    (line,) = (text for text in capsys.readouterr().out.splitlines() if "rank.marks" in text)
    assert line == "setting rank.marks: not there -> ['3501f7a7a7a7…', '3502f6b6b6b6…']"


def test_inputs_are_compared_by_content(pair):
    def change(metrics):
        first, second = metrics["inputs"][:2]
        first.update(sha256="f" * 64, lines=first["lines"] + 1)
        second["path"] = "elsewhere/" + second["path"]
        metrics["inputs"].append({**first, "path": "new.txt", "sha256": "e" * 64})

    change_metrics(pair[1], change)
    diff = run_diff(*pair)
    assert [(e["path"], e["what"]) for e in diff.inputs] == [(diff.inputs[0]["path"], "changed"), ("new.txt", "added")]


@pytest.fixture
def noisy(pair):
    """1 dB of white noise on the replay of one link of the second report."""
    rng = np.random.default_rng(5)

    def change(table):
        noise = np.where(on(table), rng.normal(0, 1.0, len(table)), 0.0)
        return table.assign(simulated_dbm=table["simulated_dbm"] + noise, residual_db=table["residual_db"] - noise)

    tables = pd.read_csv(pair[0] / "rss.csv"), change_table(pair[1], "rss", change)
    return pair, tables


def test_noise_on_one_link_is_found_there_and_sized(noisy):
    pair, tables = noisy
    diff = run_diff(*pair)
    by_link = {(row.tower, row.channel): row for row in diff.levels}
    hit = by_link.pop(LINK)
    expected = [np.nanstd(table.loc[on(table), "residual_db"]) for table in tables]  # about its mean: the best offset
    assert (hit.rmse.other_rmse_db, hit.rmse.rmse_db) == pytest.approx(expected, abs=1e-9)
    low, high = hit.rmse.difference_ci95_db
    truth = np.hypot(expected[0], 1.0) - expected[0]
    assert low < truth < high
    assert low > 0, "a decibel of noise is known to be worse"
    assert hit.rmse.verdict == "worse"
    apart = (tables[1]["simulated_dbm"] - tables[0]["simulated_dbm"])[on(tables[0])]
    assert hit.simulated_rms_db == pytest.approx(np.sqrt(np.nanmean(apart**2)))
    assert hit.simulated_max_db == pytest.approx(np.nanmax(np.abs(apart)))
    assert hit.measured_max_db == 0.0
    assert {row.rmse.difference_db for row in by_link.values()} == {0.0}
    assert "significantly worse: +" in verdict(diff)


def test_a_few_common_samples_are_named_and_links_without_interval_are_not_called_alike(noisy):
    (first, second), _ = noisy
    change_table(second, "rss", lambda table: table.groupby(["tower", "channel"]).head(4))
    diff = run_diff(first, second)
    scored = [row for row in diff.levels if row.rmse.n]
    text = verdict(diff)
    assert f"RSS over {4 * len(scored)} common samples of " in text
    assert "too few independent samples" in text
    assert "not significant" not in text
    assert any("was changed after the report wrote it" in text for text in diff.remarks)


def test_the_other_way_round_has_the_other_sign(noisy):
    (first, second), _ = noisy
    forth, reverse = run_diff(first, second), run_diff(second, first)
    for there, back in zip(forth.levels, reverse.levels, strict=True):
        assert there.rmse.difference_db == -back.rmse.difference_db
    assert forth.pooled.verdict == "worse"
    assert reverse.pooled.verdict == "better"
    assert "significantly better: −" in verdict(reverse)


def test_a_replay_that_moved_without_harm_is_said_to_have_moved(pair):
    """Measurement and replay of a link shifted together: the residual is the same."""
    change_table(
        pair[1],
        "rss",
        lambda t: t.assign(
            **{name: t[name] + 3.0 * on(t) for name in ("simulated_dbm", "calibrated_db", "measured_db")}
        ),
    )
    diff = run_diff(*pair)
    assert "measured level by up to 3 dB; " in verdict(diff)


def test_links_are_pooled_by_what_each_adds_at_an_instant():
    """Two links change in opposite directions: their means are not a correlation of the flight."""
    rng = np.random.default_rng(8)
    time, links, truth = np.arange(3000) * 0.1, [], []
    for before, after in ((2.0, 3.0), (4.0, 3.5)):
        first, second = (rng.normal(0, sd, 3000) for sd in (before, after))
        links.append((time, second, first))
        truth.append(after**2 - before**2)
    pooled = pooled_difference(links)
    low, high = pooled.mean_square_ci95_db2
    assert low < np.mean(truth) < high
    # white noise: the variance of a mean square is 2 sigma^4 / n
    spread = np.sqrt(sum(2 * s**4 for s in (2.0, 3.0, 4.0, 3.5)) / 3000) / 2
    assert 0.8 < (high - low) / 2 / (1.96 * spread) < 5.0  # the memory of white noise is not known to be none
    once, twice = (np.ptp(pooled_difference(links[:1] * n).mean_square_ci95_db2) for n in (1, 2))
    assert twice == pytest.approx(once, rel=0.2), "one link written down twice is worth no more"


def test_samples_of_one_report_alone_are_counted_and_left_out(pair):
    change_table(pair[1], "rss", lambda table: table[~(on(table) & (table["time_s"] > 900))])
    level = next(row for row in run_diff(*pair).levels if (row.tower, row.channel) == LINK)
    table = pd.read_csv(pair[0] / "rss.csv")
    dropped = int((on(table) & (table["time_s"] > 900)).sum())
    assert dropped > 0
    assert (level.samples.only_first, level.samples.only_second) == (dropped, 0)
    assert level.samples.common == level.samples.first - dropped
    assert level.rmse.difference_db == 0.0
    assert any(f"{dropped} samples only in the first" in text for text in run_diff(*pair).differences)


def test_samples_at_one_instant_pair_in_their_order(pair):
    for folder in pair:
        change_table(
            folder, "rss", lambda t: t.assign(time_utc=t["time_utc"].where(t["time_s"] > 5, t["time_utc"].iloc[0]))
        )
    change_table(pair[1], "rss", lambda t: t.iloc[1:])
    level = run_diff(*pair).levels[0]
    assert level.samples.common == level.samples.first - 1
    assert level.samples.only_second == 0


def test_ranks_that_changed_are_counted_and_agreement_is_that_of_the_pairs(pair):
    rng = np.random.default_rng(2)

    def change(table):
        turn = (rng.random(len(table)) < 0.2) & (table["simulated_rank_k10"] > 0)
        return table.assign(
            simulated_rank_k10=table["simulated_rank_k10"].where(~turn, 5 - table["simulated_rank_k10"])
        )

    first = pd.read_csv(pair[0] / "rank.csv")
    second = change_table(pair[1], "rank", change)
    by_k = {row.k: row for row in run_diff(*pair).ranks}
    hit = by_k["10"]
    assert hit.n_changed == int((first["simulated_rank_k10"] != second["simulated_rank_k10"]).sum()) > 50
    both = first["measured_rank"].notna() & (first["simulated_rank_k10"] > 0)
    agree = [float((t["measured_rank"] == t["simulated_rank_k10"])[both].mean()) for t in (first, second)]
    assert (hit.agreement.first, hit.agreement.second) == pytest.approx(agree)
    sklearn = pytest.importorskip("sklearn.metrics")
    kappa = [
        sklearn.cohen_kappa_score(t["measured_rank"][both].astype(int), t["simulated_rank_k10"][both].astype(int))
        for t in (first, second)
    ]
    assert (hit.kappa.first, hit.kappa.second) == pytest.approx(kappa)
    for change in (hit.agreement, hit.kappa):
        assert change.ci95[0] <= change.difference <= change.ci95[1]
        assert change.ci95[0] < change.ci95[1]
    assert hit.n_reported_changed == 0
    assert by_k["100"].n_changed == 0
    assert "simulated ranks" in verdict(run_diff(*pair))


# --- what cannot be compared -----------------------------------------------------------------------------------------


def cut_last_line(folder):
    path = folder / "rss.csv"
    path.write_bytes(path.read_bytes()[:-20])


def tear_a_line(folder):
    path = folder / "rss.csv"
    lines = path.read_text().splitlines()
    lines[5] = lines[5][:20]
    path.write_text("\n".join(lines) + "\n")


def word_for_number(folder):
    path = folder / "rss.csv"
    lines = path.read_text().splitlines()
    cells = lines[3].split(",")
    cells[8] = "loud"
    lines[3] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


def without(*keys):
    return lambda folder: change_metrics(folder, lambda m: [m.pop(key) for key in keys])


BAD = {
    "a truncated last line": (cut_last_line, r"rss\.csv, line \d+: the last line does not end.*truncated", InputError),
    "a torn line": (tear_a_line, r"rss\.csv, line 6: .*truncated", InputError),
    "a word": (word_for_number, r"rss\.csv, line 4: column 'measured_db': 'loud'; expected a number", InputError),
    "an older table": (lambda f: change_table(f, "rss", lambda t: t.drop(columns="up_m")), r"no column 'up_m'.*older", InputError),
    "an empty table": (lambda f: (f / "rank.csv").write_text(""), r"rank\.csv: .*expected the table rank\.csv", InputError),
    "binary": (lambda f: (f / "rss.csv").write_bytes(b"\xff\xfe\x00\n"), r"rss\.csv: ", InputError),
    "no table": (lambda f: (f / "rss.csv").unlink(), r"rss\.csv: cannot be read", InputError),
    "an older report": (without("settings"), r"no 'settings'.*run the report again", InputError),
    "no report": (without("rss", "rank"), r"expected metrics\.json of `aerpaw-cmp report`", InputError),
    "a map": (lambda f: (f / "metrics.json").write_text('{"grid": {}, "rank": []}'), r"a map, a calibration", InputError),
    "a list": (lambda f: (f / "metrics.json").write_text("[]"), r"has no 'flight'", InputError),
    "deep": (lambda f: (f / "metrics.json").write_text("[" * 100_000), r"metrics.json of a report", InputError),
    "other kinds": (lambda f: change_metrics(f, lambda m: m.update(inputs=[1])), r"has no 'inputs', which every report writes", InputError),
    "numbers for links": (lambda f: change_metrics(f, lambda m: m["rss"].update(LW1=[3])), r"has no 'rss', which every report writes", InputError),
    "an edited offset": (lambda f: change_metrics(f, lambda m: m["rss"]["LW1"]["USRP1"].update(offset_db="many")), r"has no 'rss'.*an edited file", InputError),
    "an edited input": (lambda f: change_metrics(f, lambda m: m["inputs"][0].update(sha256=[])), r"has no 'inputs'", InputError),
    "a torn json": (lambda f: (f / "metrics.json").write_text('{"flight": '), r"a truncated copy", InputError),
    "a campaign": (lambda f: (f / "metrics.json").rename(f / "campaign.json"), r"no metrics\.json.*campaign\.json", InputError),
    "nothing": (shutil.rmtree, r"there is no such folder; expected the folder of a report", InputError),
    "a file": (lambda f: (shutil.rmtree(f), f.write_text("{}")), r"this is a file; expected the folder of a report", InputError),
    "another flight": (
        lambda f: change_metrics(f, lambda m: m.update(flight="other", inputs=[m["inputs"][0] | {"sha256": "0" * 64}])),
        r"different flights: \S+ and other", UsageError
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_report_is_one_message(name, pair, capsys):
    damage, said, kind = BAD[name]
    damage(pair[1])
    with pytest.raises(kind, match=said):
        run_diff(*pair)
    assert main(["diff", str(pair[0]), str(pair[1]), "--json"]) == kind.exit_code
    shown = capsys.readouterr()
    assert shown.out == ""
    assert len(shown.err.splitlines()) == 1


def test_a_renamed_flight_with_the_same_logs_is_the_same(pair):
    change_metrics(pair[1], lambda m: m.update(flight="renamed"))
    assert run_diff(*pair).differences == ()


def test_links_that_the_flight_itself_taught_are_named(pair):
    change_metrics(pair[1], lambda m: m["rss"]["LW1"]["USRP1"].update({KEY: ["0" * 64]}))
    said = [text for text in run_diff(*pair).remarks if "learned from this flight's own log" in text]
    assert [text.partition(": ")[2].partition(":")[0] for text in said] == ["LW1 USRP1"]


def test_links_of_one_report_alone_are_named(pair):
    change_metrics(pair[1], lambda m: m["rss"].pop("LW4"))
    diff = run_diff(*pair)
    assert diff.links_first_only == ("LW4 USRP1",)
    assert "only the first report has LW4 USRP1" in diff.differences


# --- what is printed -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("word", ["better", "worse", "not significant", "no interval"])
def test_a_difference_of_reports_says_what_its_interval_does(word):
    said = DIFFERENCE[word].format(difference=0.31, interval="[+0.10, +0.52]")
    assert [w for w in ("better", "worse") if w in said] == ([word] if word in ("better", "worse") else [])
    assert "+0.31 dB" in said


def test_json_has_the_listed_keys_and_every_difference(noisy, capsys):
    (first, second), _ = noisy
    assert main(["diff", str(first), str(second), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert unlisted("diff", printed) == []
    assert printed["differs"] is True
    assert printed["differences"] == list(run_diff(first, second).differences)
    assert printed["levels"][0]["rmse"]["verdict"] == "worse"


def test_the_terminal_prints_a_change_of_agreement_as_a_percentage(pair, capsys):
    """As pages and the tables of campaigns do. Kappa is not a share."""
    change_table(pair[1], "rank", lambda t: t.assign(simulated_rank_k10=t["measured_rank"]))
    assert main(["diff", str(pair[0]), str(pair[1])]) == 0
    row = next(r for r in run_diff(*pair).ranks if r.k == "10")
    shown = capsys.readouterr().out
    assert f"{row.agreement.difference:+.1%}" in shown
    assert f"{row.kappa.difference:+.3f}" in shown
    assert row.agreement.difference > 0.01

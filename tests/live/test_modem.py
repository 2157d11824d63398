"""Commands by allow-list, answers by token, personal data out."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.live.modem import QUERIES, Redactor, csi_write, decode, encode
from tests.real_logs import REAL

SA = '+QENG: "servingcell","NOCONN","NR5G-SA","TDD",999,99,0002A4001,77,1F,633984,78,12,-80,-11,25,1,-'
ENDC = (
    '+QENG: "servingcell","CONNECT"',
    '+QENG: "LTE","FDD",999,99,12AB34,101,1300,3,5,5,1F2E,-95,-12,-63,14,9,200,-',
    '+QENG:"NR5G-NSA",999,99,812,-82,19,-11,528030,41,12,1',
)


@pytest.mark.parametrize(
    "command",
    [
        "AT+CFUN=1,1",
        'AT+EGMR=1,7,"0"',
        "AT+QRSRP;+CFUN=0",
        "AT+QRSRP\rAT+CFUN=0",
        "AT+QRSRP\n",
        'AT+QNWCFG="csi_ctrl",1,1',
        'AT+QNWCFG="csi_ctrl",2,1',
        "",
    ],
)
def test_only_listed_commands_leave(command):
    with pytest.raises(UsageError, match="not allowed"):
        encode(command)


def test_csi_switch_needs_permission():
    assert encode(csi_write(1, 1), allow_csi=True) == b'AT+QNWCFG="csi_ctrl",1,1\r'
    with pytest.raises(UsageError, match="--enable-csi"):
        encode(csi_write(1, 1))
    with pytest.raises(UsageError):
        encode('AT+QNWCFG="csi_ctrl",2,1', allow_csi=True)


def test_no_query_asks_for_identity_of_the_subscriber():
    forbidden = ("CGSN", "CIMI", "CCID", "CNUM", "EGMR", "GSN", "=1")
    assert not [q.text for q in QUERIES.values() if any(word in q.text for word in forbidden)]


@pytest.mark.parametrize(
    ("line", "rank", "flag"),
    [
        ('+QNWCFG: "nr5g_csi",29,2,7,28', 2, None),
        ('+QNWCFG:"nr5g_csi",13,4,8,896', 4, None),
        ('+QNWCFG: "nr5g_csi",0,0,0,0', None, "no_csi"),
        ('+QNWCFG: "nr5g_csi",7,9,8,1', None, "ri_raw:out_of_range(9)"),
        ('+QNWCFG: "nr5g_csi",7,2', None, "torn:2_of_4_fields"),
        ('+QNWCFG: "nr5g_csi",7,x,8,1', None, "ri_raw:not_a_number"),
        ('+QNWCFG: "nr5g_csi",7,3,255,1', 3, None),
    ],
)
def test_rank(line, rank, flag):
    decoded = decode("nr5g_csi", [line])
    assert decoded.values["rank"] == rank
    assert decoded.flags == (() if flag is None else (flag,))


def test_one_bad_field_costs_only_itself():
    values = decode("nr5g_csi", ['+QNWCFG: "nr5g_csi",99,3,8,1']).values
    assert (values["mcs"], values["rank"], values["cqi"]) == (None, 3, 8)
    assert decode("nr5g_csi", ['+QNWCFG: "nr5g_csi",9,3,255,1,5']).values == {
        "mcs": 9,
        "ri_raw": 3,
        "cqi": None,
        "pmi": 1,
        "extra": ["5"],
        "rank": 3,
    }


def test_sa_and_endc_order_rsrq_and_sinr_differently():
    sa = decode("servingcell", [SA]).values
    assert (sa["rat"], sa["state"]) == ("NR5G-SA", "NOCONN")
    assert [sa["nr"][k] for k in ("rsrp_dbm", "rsrq_db", "sinr_db", "bandwidth_mhz", "scs_khz")] == [
        -80,
        -11,
        25,
        100,
        30,
    ]
    endc = decode("servingcell", ENDC).values
    assert (endc["rat"], endc["state"]) == ("EN-DC", "CONNECT")
    assert [endc["nr"][k] for k in ("rsrp_dbm", "rsrq_db", "sinr_db", "pcid", "band")] == [-82, -11, 19, 812, 41]
    assert [endc["lte"][k] for k in ("rsrp_dbm", "rsrq_db", "sinr_raw", "cqi")] == [-95, -12, 14, 9]
    assert "sinr_db" not in endc["lte"]  # its unit is not known


def test_absent_leg_sentinels_and_tenths():
    decoded = decode(
        "servingcell", ['+QENG: "servingcell","NOCONN"', ENDC[1], '+QENG:"NR5G-NSA",999,99,65535,-32768,-32768,-32768']
    )
    assert decoded.values["nr"]["rsrp_dbm"] is None
    assert decoded.flags == ("nr_absent",)
    decoded = decode("servingcell", ['+QENG:"NR5G-NSA",999,99,500,-75,180,-11'])
    assert decoded.values["nr"]["sinr_db"] is None
    assert decoded.values["nr"]["rsrp_dbm"] == -75
    assert decoded.flags == ("nr.sinr_db:out_of_range(180)",)
    limited = SA.replace("NOCONN", "LIMSRV").replace(",25,1,-", ",-3276,1,44")
    assert decode("servingcell", [limited]).values["nr"]["sinr_db"] is None
    assert decode("servingcell", [limited]).values["nr"]["srxlev_db"] == 44
    assert decode("servingcell", ['+QENG: "servingcell","SEARCH"']).values == {"state": "SEARCH", "rat": None}
    lte = decode(
        "servingcell",
        ['+QENG: "servingcell","NOCONN","LTE","FDD",999,99,A1,1,1300,3,5,5,F4,-109,-15,-73,11,255,-32768,16'],
    ).values
    assert (lte["rat"], lte["lte"]["cqi"], lte["lte"]["tx_power_tenth_dbm"], lte["lte"]["bandwidth_mhz"]) == (
        "LTE",
        None,
        None,
        20,
    )


def test_antennas():
    decoded = decode("qrsrp", ["+QRSRP: -90,-92,-140,-32768,LTE", "+QRSRP: -80,-81,-82,-83,NR5G"])
    assert decoded.values["LTE"] == {"rsrp_dbm": [-90, -92, -140, None]}
    assert decoded.values["NR5G"] == {"rsrp_dbm": [-80, -81, -82, -83]}
    assert decoded.flags == ("LTE.rx2.floor",)
    assert decode("qsinr", ["+QSINR: 20,19,18,17"]).values == {"untagged": {"sinr_db": [20, 19, 18, 17]}}


@pytest.mark.field
def test_recorded_answers_decode():
    ranks, cells = [], []
    for path in sorted((REAL / "modem").glob("at_*.txt")):
        for answer in path.read_text(encoding="latin-1").split("OK\n"):
            lines = [line.strip() for line in answer.splitlines()]
            csi = [line for line in lines if line.startswith('+QNWCFG: "nr5g_csi",') and "(" not in line]
            ranks += [decode("nr5g_csi", [line]).values["rank"] for line in csi]
            cell = [line for line in lines if line.startswith("+QENG")]
            cells += [decode("servingcell", cell)] if cell else []
    assert ranks == [2, 2]
    assert len(cells) >= 7
    assert all(cell.values["rat"] in ("NR5G-SA", "EN-DC", "LTE") for cell in cells)
    levels = {(c.values["rat"], (c.values.get("nr") or c.values["lte"])["rsrp_dbm"]) for c in cells}
    assert {
        ("NR5G-SA", -68),
        ("NR5G-SA", -109),
        ("NR5G-SA", -104),
        ("EN-DC", -76),
        ("EN-DC", -96),
        ("LTE", -93),
    } <= levels


# all invented: an IMEI with its right check digit, IMSI of the test network 001-01, and so on
PERSONAL = [
    "490154203237518",
    "001010123456789",
    "8949020000012345678F",
    "+4915123456789",
    "49-015420-323751-8",
    "01701234567",
]


@pytest.mark.parametrize("secret", PERSONAL)
@pytest.mark.parametrize(
    "line",
    [
        "{}",
        "IMEI: {}",
        '+CPIN: "{}"',
        "+QCCID: {}",
        '+CNUM: ,"{}",145',
        "x{}y",
        "\0\xff{}\x01",
        '+CMT: "{}",,"26/01/01"',
    ],
)
def test_personal_data_is_removed(line, secret):
    cleaned = Redactor().clean(line.format(secret))
    assert secret not in cleaned
    assert not any(secret.replace("-", "")[i : i + 7] in cleaned.replace("-", "") for i in range(len(secret) - 7))


def test_cut_numbers_and_message_texts_are_removed():
    redactor = Redactor()
    assert redactor.clean("+X: 49015420", cut=True) == "+X: <redacted>"
    redactor.clean('+CMT: "+4915123456789",,"26/01/01,00:00:00+00"')
    assert redactor.clean("my secret message") == "<redacted message>"
    assert redactor.clean("OK") == "OK"


@pytest.mark.parametrize(
    "line",
    [
        SA,
        *ENDC,
        "+QRSRP: -80,-81,-82,-83,NR5G",
        '+QNWINFO: "TDD NR5G","99999","NR5G BAND 78",633984',
        "Revision: RM502QAEAAR13A02M4G",
    ],
)
def test_redaction_leaves_measurements_alone(line):
    assert Redactor().clean(line) == line


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from(sorted(QUERIES)),
    st.lists(st.text(max_size=80), max_size=4),
    st.sampled_from(["", "+QENG: ", '+QNWCFG: "nr5g_csi",', "+QRSRP: ", "+QCAINFO: "]),
)
def test_decoding_never_raises(name, lines, prefix):
    decoded = decode(name, [prefix + line for line in lines])
    assert isinstance(decoded.values, dict)


@settings(max_examples=200, deadline=None)
@given(st.integers(-200, 100), st.integers(-100, 100), st.integers(-100, 100))
def test_fields_are_in_range_or_none(rsrp, rsrq, sinr):
    line = f'+QENG: "servingcell","NOCONN","NR5G-SA","TDD",999,99,0002A4001,77,1F,633984,78,12,{rsrp},{rsrq},{sinr},1,-'
    decoded = decode("servingcell", [line])
    nr = decoded.values["nr"]
    assert nr["rsrp_dbm"] == (rsrp if -156 <= rsrp <= -31 else None)
    assert nr["sinr_db"] == (sinr if -23 <= sinr <= 40 else None)
    assert nr["rsrq_db"] == (rsrq if -43 <= rsrq <= 20 else None)
    assert len([f for f in decoded.flags if "out_of_range" in f]) == [
        nr["rsrp_dbm"],
        nr["sinr_db"],
        nr["rsrq_db"],
    ].count(None)

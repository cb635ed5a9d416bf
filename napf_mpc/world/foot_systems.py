"""Coordinate reference systems in feet: numbers of their files, taken as metres, are 3.28 times too large.

Codes of the EPSG Geodetic Parameter Dataset, version 11.022 (https://epsg.org), as read from PROJ's database
by pyproj 3.7.2: all projected, vertical and compound systems, deprecated ones too, with an axis in feet of
any kind (international, US survey, British, Clarke's, Gold Coast).
"""

from __future__ import annotations

__all__ = ["FOOT_SYSTEMS"]

# first-last for every code between, /2 for every other one.
_CODES = """
    2136 2155 2159-2160 2194 2204 2222-2289 2314 2867-2930 2964-2968 2992 2994 3080 3089 3091 3102
    3359-3365/2 3404 3407 3417-3438 3441-3446 3451-3459 3479-3487/2 3490-3512/2 3515-3553/2 3560-3570
    3582-3590/2 3593 3598 3600 3605 3608-3636/2 3640-3664/2 3668-3676/2 3677 3679-3680 3682-3683
    3686-3692/2 3696-3700/2 3728-3739 3753-3760 3991-3992 4217 4399-4413 4418-4433 4438-4439 4455-4457
    5588-5589 5614 5623-5625 5646 5654-5655 5702 5754 6128-6132 6141 6200-6202 6358-6360 6391 6405-6413/2
    6416-6438/2 6441-6479/2 6484-6496/2 6499-6507/2 6510 6515-6565/2 6568-6578/2 6582-6590/2 6593-6609/2
    6612-6618/2 6625-6627 6633 6785-6863/2 6868 6880 6885 6887 6923 6925 6966 6997 7057-7070 7119-7128
    7132 7258-7370/2 7406-7407 7587-7645 8035-8036 8050-8053 8065-8068 8091 8093 8096-8172/2 8177 8180
    8182 8185 8189 8193 8197 8200-8210/2 8213 8216 8220 8224-8228/2 8312-8348/2 8380-8384/2 8387 8518-8529
    8531 8533-8536 8538-8540 8700-8800 8897 9502-9504 9748-9749 10481 10516 10622 20050 23301-23333 24100
    26729-26760 26766-26787 26791-26799 26801-26803 26811-26813 26847-26870 29872 32001-32003 32005-32031
    32033-32058 32064-32067 32074-32077 32099 32164-32167 32664-32667
"""


def _spelled_out(text: str) -> frozenset[int]:
    codes: set[int] = set()
    for word in text.split():
        span, _, step = word.partition("/")
        first, _, last = span.partition("-")
        codes.update(range(int(first), int(last or first) + 1, int(step or 1)))
    return frozenset(codes)


FOOT_SYSTEMS = _spelled_out(_CODES)
"""EPSG codes."""

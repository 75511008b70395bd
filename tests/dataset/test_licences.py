"""Licences by their names: nothing that is not recognised is permitted."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tableverse_factory.dataset.licences import PROFILES, LicenceVerdict, classify_license


@pytest.mark.parametrize(
    ("names", "verdict"),
    [
        ("CC0-1.0|CC0|cc0 1.0|Public Domain|PDM|CC-BY-4.0|CC BY 4.0|cc by|MIT|Apache-2.0|BSD-3-Clause", "permissive"),
        (
            "https://creativecommons.org/licenses/by/4.0/|http://creativecommons.org/publicdomain/zero/1.0/",
            "permissive",
        ),
        ("Creative Commons Attribution 4.0 International|CC0 1.0 Universal|CC-BY-3.0-DE|Apache License", "permissive"),
        ("CC-BY-SA-4.0|CC BY-SA 3.0|https://creativecommons.org/licenses/by-sa/4.0/deed.en|ODbL-1.0", "share-alike"),
        ("GPL-3.0-only|GPL-3.0-or-later|AGPL-3.0-only|LGPL-2.1|MPL-2.0", "share-alike"),
        ("CC-BY-NC-4.0|CC BY-NC-SA 4.0|cc-by-nc-sa|CC BY NC", "non-commercial"),
        ("Creative Commons Attribution-NonCommercial-ShareAlike 4.0 International", "non-commercial"),
        ("CC-BY-ND-4.0|CC-BY-NC-ND-4.0|https://creativecommons.org/licenses/by-nc-nd/2.0/", "no-derivatives"),
        (
            "https://creativecommons.org/licenses/by/4.0/deed.pt-BR|https://creativecommons.org/licenses/by/3.0/de/legalcode"
            "|https://www.creativecommons.org/publicdomain/mark/1.0|https://creativecommons.org/licenses/by/3.0/igo/",
            "permissive",
        ),
        ("All rights reserved|Proprietary|Unsplash|Unsplash License|the Pexels license", "restricted"),
        ("||||free for research|CC-BY-XX|MITT|my own|(MIT)|MIT WITH exception|CC|by|Creative Commons", "unknown"),
        ("CC BY NC ??|not CC0|CC0 but not for robots|MIT, CC0|cc-by-4.0-nc", "unknown"),
        ("not MIT or BSD|Free for research or MIT|the licence is unknown, maybe CC0 or MIT", "unknown"),
        ("CC BY 4.0 or|CC BY 3.0 or|CC BY 4.0 no", "unknown"),
        ("CC BY or CC BY-NC depending on the picture|no licence or public domain", "unknown"),
        (
            "MIT or ask me for commercial use|CC0-1.0 or later|MIT OR|MIT; not for sale|MIT [not really]",
            "unknown",
        ),
        (
            "https://creativecommons.org/licenses/by/4.0/nc|https://creativecommons.org/licenses/by/nc/4.0"
            "|https://creativecommons.org/licenses/by/4.0/../../by-nc/4.0/|https://creativecommons.org/licenses/zero/1.0"
            "|https://creativecommons.org/licenses/by-nc-sa/by/|https://creativecommons.org/licenses/by/4.0/deed.en/nc",
            "unknown",
        ),
    ],
)
def test_names(names, verdict):
    for name in names.split("|"):
        assert classify_license(name) == verdict, name
        assert classify_license(f"  {name.upper()}\n") == verdict, name


def test_expressions():
    assert classify_license("MIT OR CC-BY-NC-4.0") == LicenceVerdict.PERMISSIVE
    assert classify_license("MIT AND CC-BY-NC-4.0") == LicenceVerdict.NON_COMMERCIAL
    assert classify_license("GPL-3.0-only OR MIT AND CC-BY-NC-4.0") == LicenceVerdict.SHARE_ALIKE
    assert classify_license("MIT OR All rights reserved") == LicenceVerdict.RESTRICTED
    assert classify_license("CC-BY-NC-4.0 AND (GPL-2.0 OR MIT OR BSD-3-Clause)") == LicenceVerdict.UNKNOWN, (
        "brackets are not read"
    )
    assert classify_license("GPL-3.0-only OR MIT AND what is this") == LicenceVerdict.UNKNOWN, (
        "one part that nobody knows decides"
    )
    assert classify_license("CC0-1.0 AND who knows") == LicenceVerdict.UNKNOWN
    assert classify_license(None) == LicenceVerdict.UNKNOWN
    assert classify_license("MIT " * 1000) == LicenceVerdict.UNKNOWN


@given(st.lists(st.sampled_from(["MIT", "CC0", "CC BY 4.0"]), min_size=1), st.text(max_size=40), st.data())
def test_a_part_that_is_not_permitted_alone_is_not_permitted_among_others(names, free_text, data):
    alone = classify_license(free_text)
    place = data.draw(st.integers(0, len(names)))
    for word in (" or ", " AND "):
        whole = classify_license(word.join([*names[:place], free_text, *names[place:]]))
        assert whole != LicenceVerdict.PERMISSIVE or alone == LicenceVerdict.PERMISSIVE


@given(st.text(max_size=600))
def test_any_text_has_a_verdict(text):
    assert classify_license(text) in LicenceVerdict


def test_profiles_grow_and_never_hold_the_unknown():
    permissive, alike, noncommercial = PROFILES.values()
    assert permissive < alike < noncommercial
    assert not noncommercial & {LicenceVerdict.UNKNOWN, LicenceVerdict.RESTRICTED, LicenceVerdict.NO_DERIVATIVES}

"""The page of the studio: who may use it, and that it shows the same to every browser."""

import time
import urllib.error
import urllib.request

import pytest
from browser import CHROMIUM, chromium
from hand import Hand

from rejoint.studio.page import TITLES, studio_view

missing = pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: install it to see the studio in a browser")


def seen(test):
    """Mark a test that needs a browser, which takes its time."""
    return pytest.mark.realtime(missing(test))


def asked(address, **headers):
    """Status and start of what a page answers; redirections are followed with the cookie that they set."""
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    request = urllib.request.Request(address, headers={name.title(): value for name, value in headers.items()})
    try:
        with opener.open(request, timeout=20) as answer:
            return answer.status, answer.read(200)
    except urllib.error.HTTPError as error:
        return error.code, error.read()


@pytest.mark.parametrize("place", ["127.0.0.1", "127.0.0.2"])
def test_other_sites_and_other_names_of_this_computer_are_refused(studio, place):
    with studio_view(studio, place, 0) as view:
        assert asked(view.address)[0] == 200
        assert asked(view.address, host="localhost")[0] == 200
        assert asked(view.address, origin=view.address)[0] == 200
        assert asked(view.address, origin="http://elsewhere.example")[0] == 403
        assert asked(view.address, host="elsewhere.example:80")[0] == 403
        assert asked(f"{view.address}/report")[0] == 404


def test_other_computers_need_the_token(studio):
    with studio_view(studio, "127.0.0.1", 0, "secret") as view:
        plain, _, token = view.address.partition("/?token=")
        assert token == "secret"
        assert asked(plain)[0] == 403
        assert asked(f"{plain}/?token=guessed")[0] == 403
        assert asked(view.address)[0] == 200


@seen
def test_clicks_alone_choose_an_arm_and_a_second_tab_sees_the_same(studio):
    with studio_view(studio, "127.0.0.1", 0) as view, chromium(1300, 850) as tab:
        hand = Hand(tab)
        hand.open(view.address)
        hand.type("or its address", "tcp://127.0.0.1:9")
        hand.press("Connect")
        hand.reads("127.0.0.1:9")
        hand.type("or its address", "emulated:worn")
        hand.press("Connect")
        hand.press("The table is clear: move one joint")
        hand.press("Yes")
        hand.reads("3 What is wrong?")
        hand.open(view.address)  # a reload
        hand.reads("3 What is wrong?")
        assert studio.status.step == "diagnose"
        with chromium(420, 850) as second:
            other = Hand(second)
            other.open(view.address)
            other.reads("3 What is wrong?")
            studio.do("asking", lambda machine: machine.ask("?"))
            for one in (hand, other):
                one.reads("asking")
            other.press("STOP")
            hand.reads("stopped by the stop button")


@seen
def test_the_job_ends_when_the_last_page_is_closed_unless_the_owner_wants_it_to_go_on(studio):
    with studio_view(studio, "127.0.0.1", 0) as view:
        for goes_on in (True, False):
            with chromium(1000, 700) as tab:
                hand = Hand(tab)
                hand.open(view.address)
                hand.reads("Connect")
                hand.press_text("When the browser is closed")
                hand.choose("The arm", "goes on" if goes_on else "stops and holds")
                studio.do("asking", lambda machine: machine.ask("?"))
                hand.reads("asking")
            time.sleep(8.0)
            assert studio.status.busy == goes_on
            studio.stop()
            while studio.status.busy:
                time.sleep(0.05)


@seen
@pytest.mark.parametrize("width", [1300, 420])
def test_the_stop_button_stays_in_sight_whatever_is_scrolled_or_folded(studio, width):
    title = """[...document.querySelectorAll('div')].filter((e) => e.childElementCount === 0
        && e.textContent.trim() === 'rejoint studio').pop().getBoundingClientRect()"""
    with studio_view(studio, "127.0.0.1", 0) as view, chromium(width, 850) as tab:
        tab.call("Emulation.setDeviceMetricsOverride", width=width, height=850, deviceScaleFactor=1, mobile=width < 600)
        hand = Hand(tab)
        hand.open(view.address)
        hand.reads("Connect")
        hand.reads("rejoint studio")
        hand.touch(tab.ask(f"{title}.x + 5"), tab.ask(f"{title}.y + 5"))  # folds a panel of viser
        hand.touch(width - 13, 7)  # so does this
        hand.touch(width - 26, tab.ask(f"{title}.y + 10"))  # its settings would come in place of the panel
        for step in TITLES:
            studio.change(step=step)
            hand.reads(TITLES[step][3:])
            tab.ask("document.querySelectorAll('[data-scrollarea-viewport]').forEach((e) => e.scrollTo(0, 9999))")
            assert hand.sees("STOP"), step

"""A real browser without a window."""

import shutil
import time

import pytest


@pytest.fixture(scope="session")
def chromium():
    """Chromium, driven by Selenium; what it logs can be read."""
    webdriver = pytest.importorskip("selenium.webdriver")
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if found is None or driver is None:
        pytest.skip("no Chromium with its driver here: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = found
    for option in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    browser.implicitly_wait(0)
    yield browser
    browser.quit()


@pytest.fixture
def look(chromium):
    """Open an address at a width; light or dark, on screen or on paper."""

    def opened(address, width, scheme="light", media="screen"):
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media, "features": features})
        chromium.get_log("browser")
        chromium.get(str(address))
        return chromium

    return opened


def wait_until(what, seconds=10.0):
    """Wait for something to become true, and return it."""
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.02)
    return found


@pytest.fixture
def moves():
    """Whether the path of a line takes several shapes, none of them broken."""

    def watched(line):
        paths = set()
        wait_until(lambda: paths.add(line.get_attribute("d")) or len(paths) >= 4)
        return not any(path is None or "NaN" in path for path in paths)

    return watched


@pytest.fixture
def drawn():
    """Wait until as many panels as this are drawn; return them."""

    def waited(browser, count):
        wait_until(lambda: len(browser.find_elements("css selector", ".panel svg .marks > *:first-child")) == count)
        return browser.find_elements("css selector", ".panel > svg")

    return waited


@pytest.fixture
def until():
    return wait_until

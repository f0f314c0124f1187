"""Opens a page in Qt's Chromium and prints what it makes of it: ``python browser.py page.html screenshot.png``."""

import json
import sys

from PyQt6.QtCore import QTimer, QUrl
from PyQt6.QtWebEngineCore import QWebEnginePage
from PyQt6.QtWebEngineWidgets import QWebEngineView
from PyQt6.QtWidgets import QApplication

FACTS = """(() => ({
    title: document.title,
    pictures: [...document.images].map(one => [one.naturalWidth, one.getBoundingClientRect().width]),
    links: [...document.links].map(one => document.getElementById(one.hash.slice(1)) !== null),
    visible: [...document.querySelectorAll("section")].map(one => one.getBoundingClientRect().height > 0),
    overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
}))()"""


class Page(QWebEnginePage):
    """Keeps what a browser would complain of in its console."""

    def javaScriptConsoleMessage(self, level, message, line, source):
        complaints.append(message)


complaints: list[str] = []
application = QApplication([sys.argv[0]])
view = QWebEngineView()
page = Page(view)
view.setPage(page)
view.resize(1200, 1600)


def report(facts):
    view.grab().save(sys.argv[2])
    print(json.dumps({**facts, "complaints": complaints}))
    application.quit()


# Pictures are painted shortly after the page is loaded
view.loadFinished.connect(lambda _: QTimer.singleShot(500, lambda: page.runJavaScript(FACTS, report)))
view.load(QUrl.fromLocalFile(sys.argv[1]))
view.show()
QTimer.singleShot(60_000, lambda: application.exit(1))
sys.exit(application.exec())

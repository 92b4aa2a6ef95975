"""Build of dtsa_bench, which setup.cfg describes."""

from xml.etree import ElementTree

from setuptools import setup

setup(version=ElementTree.parse("package.xml").findtext("version"))

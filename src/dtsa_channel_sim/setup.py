"""Build of dtsa_channel_sim, which setup.cfg describes."""

from xml.etree import ElementTree

from setuptools import setup

setup(version=ElementTree.parse("package.xml").findtext("version"))

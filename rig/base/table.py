"""The base of every table in a scene, protocol or certificate file, declared where instruments can use it too."""

from drivers.settings import Table as Table
